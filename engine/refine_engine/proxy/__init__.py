"""Meshes of any size at the price of a small one: a proxy is refined, and its displacement carried back."""
