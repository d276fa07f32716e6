"""The contract over gRPC (grpc.aio): the same calls on the same edge."""
