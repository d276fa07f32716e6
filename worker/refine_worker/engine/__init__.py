"""The engine process of a slot: torch and the method, loaded and compiled once. It knows no queue."""
