"""The camera that saw a silhouette, estimated from the silhouette and the mesh alone."""
