"""Worker slots: they take jobs from the queue and refine them, each in a warm engine process of its own.

supervisor      starts the slots, restarts one that ends or hangs, runs the reaper, answers probes
└── slot        an RQ worker without torch: claims, watches, renews the lease, ends the job
    └── engine  torch and the method, loaded and compiled once; reads, refines, writes the artifacts
"""
