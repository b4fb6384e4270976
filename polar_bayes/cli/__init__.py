"""The command line: it parses arguments, calls the Python interface and prints."""

from polar_bayes.cli.entry import commands, console, main

__all__ = ["commands", "console", "main"]
