"""The engine's subcommands of `refine`, found through the entry-point group `refine.commands`."""
