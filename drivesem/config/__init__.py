"""What a command may be told: options, ranges, presets. Nothing heavy is imported here."""
