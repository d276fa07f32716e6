-- A worker ends the job that it holds. ARGV: id, attempt, state, reason or '', retention_ms, field, value, ...
-- Returns 1, or 0 if the worker no longer holds the job.
local id, attempt, state, reason, retention_ms = unpack(ARGV, 1, 5)
if not holds(id, attempt) then
  return 0
end
if #ARGV > 5 then
  redis.call('HSET', JOB .. id, unpack(ARGV, 6))
end
end_job(id, state, reason, retention_ms)
return 1
