"""A module a command: parse what its settings say, call what does the work, print what came of it."""
