"""Tables, plots, pictures, HTML pages and terminal output."""
