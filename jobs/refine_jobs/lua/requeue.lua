-- A queued job that RQ does not know is enqueued again once it has been missing for MISSING_S.
-- ARGV: id, attempt, RQ's enqueue. Returns 1 if it was enqueued.
local id, attempt = unpack(ARGV, 1, 2)
if field(id, 'state') ~= 'queued' or field(id, 'attempt') ~= attempt then
  redis.call('HDEL', MISSING, id)
  return 0
end
local since = redis.call('HGET', MISSING, id)
if not since then
  redis.call('HSET', MISSING, id, NOW)
  return 0
end
if NOW - since < MISSING_S * 1000 then
  return 0
end
redis.call('HDEL', MISSING, id)
enqueue(id, 3)
return 1
