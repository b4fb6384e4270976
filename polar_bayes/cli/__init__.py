"""The command line: thin; it parses, calls the Python interface and prints."""

from polar_bayes.cli.entry import commands, main

__all__ = ["commands", "main"]
