-- A worker shows that it is alive, with or without progress. ARGV: id, attempt, lease_ms, progress or ''.
-- Returns the state (running, cancelling), or nothing if the worker no longer holds the job.
local id, attempt, lease_ms, progress = unpack(ARGV)
if not holds(id, attempt) then
  return nil
end
local state = field(id, 'state')
redis.call('ZADD', LEASES, NOW + lease_ms, id)
if progress ~= '' then
  redis.call('HSET', JOB .. id, 'progress', progress)
  emit(id, 'progress', state, 'progress', progress)
end
return state
