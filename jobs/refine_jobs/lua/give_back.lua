-- A job whose worker is gone, or gives it back, is queued again, at the front; not more than max_attempts times.
-- ARGV: id, attempt, now_or_expired, max_attempts, retention_ms, error of the last attempt, commands into RQ
-- now_or_expired: 'now', or 'expired' to do nothing while the lease holds.
-- Returns the new state, or nothing if nothing was done.
local id, attempt, when, max_attempts, retention_ms, problem = unpack(ARGV, 1, 6)
if not holds(id, attempt) then
  return nil
end
if when == 'expired' and tonumber(redis.call('ZSCORE', LEASES, id) or 0) > NOW then
  return nil
end
if field(id, 'state') == 'cancelling' then
  end_job(id, 'cancelled', '', retention_ms)
elseif tonumber(attempt) >= tonumber(max_attempts) then
  redis.call('HSET', JOB .. id, 'error', problem)
  end_job(id, 'failed', 'WORKER_LOST', retention_ms)
else
  redis.call('ZREM', LEASES, id)
  redis.call('HDEL', JOB .. id, 'progress', 'started_ms', 'slot')
  enter_queue(id)
  set_state(id, 'queued')
  run_commands(7)
end
return field(id, 'state')
