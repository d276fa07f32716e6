"""What both transports stand on: sign-in, submission, events, artifacts, errors, metrics."""
