"""The process of a slot, without torch: takes a job from the queue, watches its engine, ends the job."""
