"""The command line: thin; it parses, calls the Python interface and prints."""

from polar_bayes.cli.entry import commands, console, main

__all__ = ["commands", "console", "main"]
