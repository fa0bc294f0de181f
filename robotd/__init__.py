"""robotd: a small robot maps every electronic shelf label of a store. Start with ARCHITECTURE.md."""

__version__ = "0.1.0"
