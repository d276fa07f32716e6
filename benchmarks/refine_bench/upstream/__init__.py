"""A small single-view reconstruction network of our own: what REFINE gets to see, with the truth known."""
