"""The service's part of the command line: what `refine.commands` entry points name."""
