"""What service and worker share: settings, keys, blobs and the job store. No torch."""
