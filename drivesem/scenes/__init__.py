"""Where scenes come from: data sets, photographs without labels, the embedded demo."""
