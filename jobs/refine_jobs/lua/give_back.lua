-- A job whose worker gives it back, or is gone, is queued again, at the front; one that has lost max_attempts
-- workers fails. ARGV: id, attempt, now_or_expired, max_attempts, retention_ms, its error if it fails, commands into RQ
-- now_or_expired: 'now', which costs the job nothing, or 'expired' if its worker is gone once the lease is over.
-- Returns the new state, or nothing if nothing was done.
local id, attempt, when, max_attempts, retention_ms, problem = unpack(ARGV, 1, 6)
if not holds(id, attempt) then
  return nil
end
local lost = 0
if when == 'expired' then
  if tonumber(redis.call('ZSCORE', LEASES, id) or 0) > NOW then
    return nil
  end
  lost = redis.call('HINCRBY', JOB .. id, 'lost', 1)
end
if field(id, 'state') == 'cancelling' then
  end_job(id, 'cancelled', '', retention_ms)
elseif lost >= tonumber(max_attempts) then
  redis.call('HSET', JOB .. id, 'error', problem)
  end_job(id, 'failed', 'WORKER_LOST', retention_ms)
else
  redis.call('HINCRBY', METRICS, 'requeued:' .. (lost > 0 and 'lost' or 'returned'), 1)
  redis.call('ZREM', LEASES, id)
  redis.call('HDEL', JOB .. id, 'progress', 'started_ms', 'slot')
  enter_queue(id)
  set_state(id, 'queued')
  run_commands(7)
end
return field(id, 'state')
