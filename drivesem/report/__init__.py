"""How things are shown: words and bars in a terminal, tables, plots, drawn pictures, one question's answer."""
