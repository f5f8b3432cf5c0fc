"""Settings of the commands: options, constraints, presets, parsing, help."""
