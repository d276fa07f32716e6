"""The SDK and the command `refine`."""
