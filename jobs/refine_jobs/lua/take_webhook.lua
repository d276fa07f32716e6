-- A service takes the webhook that has been due longest, for itself alone until lease_ms are over. ARGV: lease_ms.
-- Returns its hash, or nothing if none is due.
local id = redis.call('ZRANGE', OUTBOX, '-inf', NOW, 'BYSCORE', 'LIMIT', 0, 1)[1]
if not id then
  return nil
end
redis.call('ZADD', OUTBOX, NOW + ARGV[1], id)
redis.call('HINCRBY', WEBHOOK .. id, 'attempt', 1)
return redis.call('HGETALL', WEBHOOK .. id)
