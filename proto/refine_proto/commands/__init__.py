"""What the commands of several packages share. The contract itself needs nothing of it."""
