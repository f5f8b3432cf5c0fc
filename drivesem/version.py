"""The version, alone: settings tell it without the rest."""

__version__ = "0.1.0"
