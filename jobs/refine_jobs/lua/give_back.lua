-- A job whose worker gives it back, or is gone, is queued again, at its place; one that has lost max_attempts
-- attempts fails. ARGV: id, attempt, how, max_attempts, retention_ms, reason and error if it fails, RQ's enqueue
-- how: 'now', which costs the job nothing; 'lost', an attempt; 'expired', an attempt, if the lease is over.
-- Returns the new state, or nothing if nothing was done.
local id, attempt, how, max_attempts, retention_ms, reason, problem = unpack(ARGV, 1, 7)
if not holds(id, attempt) then
  return nil
end
local lost = 0
if how == 'expired' and tonumber(redis.call('ZSCORE', LEASES, id) or 0) > NOW then
  return nil
end
if how ~= 'now' then
  lost = redis.call('HINCRBY', JOB .. id, 'lost', 1)
end
if field(id, 'state') == 'cancelling' then
  end_job(id, 'cancelled', '', retention_ms)
elseif lost >= tonumber(max_attempts) then
  redis.call('HSET', JOB .. id, 'error', problem)
  end_job(id, 'failed', reason, retention_ms)
else
  redis.call('HINCRBY', METRICS, 'requeued:' .. (lost > 0 and 'lost' or 'returned'), 1)
  redis.call('ZREM', LEASES, id)
  redis.call('HDEL', JOB .. id, 'progress', 'started_ms', 'slot')
  rejoin_flow(id)
  set_state(id, 'queued')
  enqueue(id, 8)
end
return field(id, 'state')
