"""What service and worker share: settings, keys, blobs and the job store. No torch.

keys             every key, name and fixed lifetime in Redis and in the blob store, on one page
settings         the REFINE_* settings that both sides have
redis_server     connections to Redis, and what a server must be for jobs to be safe in it
embedded         a Redis server of our own, for one machine
guard            ends that server when whoever started it was killed
blobs            immutable bytes by name, in a folder or a bucket
record           the record of a job and its events: from Redis' strings to values and back
scripts, lua/    each step in the life of a job, atomic; lua/README.md draws it
durable          whether Redis has what it was told on file, before anybody relies on it
delivery         how a job gets into RQ's queue and out of it
edge_store       JobStore: jobs as the edge sees them, asynchronous
worker_store     WorkerStore: jobs as a slot and the reaper see them, synchronous
webhook_outbox   calls to whoever waits for a job's end, due and failed ones, until they arrive
feed             the events of jobs, for any number of watchers
reaper           lost slots, lost deliveries, old data: put right now and then
share            how the slots are shared: cost, flow, priority
load             what waits and runs, and when a job is therefore expected to end
slots            what a slot says of itself
logs             one JSON object per line, for service and worker
build            the metric that tells which version runs
spans            a job's way through the queue, for OpenTelemetry
health           what readiness and metrics need to know of all processes
"""
