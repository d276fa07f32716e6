"""What a refinement hands back: the files, and the pictures among them."""
