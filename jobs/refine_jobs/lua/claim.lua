-- A worker starts a queued job. ARGV: id, slot, lease_ms. Returns the record, or nothing if it is not queued.
local id, slot, lease_ms = unpack(ARGV)
if field(id, 'state') ~= 'queued' then
  return nil
end
redis.call('HINCRBY', JOB .. id, 'attempt', 1)
if is_refinement(id) then
  observe('queue_s', NOW - (redis.call('ZSCORE', QUEUED_SINCE, id) or field(id, 'created_ms')))
end
start_flow(id)
redis.call('HSET', JOB .. id, 'slot', slot, 'started_ms', NOW)
redis.call('ZADD', LEASES, NOW + lease_ms, id)
set_state(id, 'running')
return redis.call('HGETALL', JOB .. id)
