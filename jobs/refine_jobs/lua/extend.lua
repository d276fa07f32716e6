-- Somebody sets the lifetime of an ended job. ARGV: id, lifetime_ms. Returns 1, or 0 if it has not ended.
local id, lifetime_ms = unpack(ARGV)
if not has_ended(field(id, 'state')) then
  return 0
end
redis.call('HSET', JOB .. id, 'expires_ms', NOW + lifetime_ms)
redis.call('ZADD', EXPIRY, NOW + lifetime_ms, id)
return 1
