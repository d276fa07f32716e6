"""The two ways to a server, REST and gRPC, behind one face (`base`)."""
