-- An ended job past its lifetime becomes a tombstone. ARGV: id, tombstone_ms. Returns 1 if it did.
local id, tombstone_ms = unpack(ARGV)
if not has_ended(field(id, 'state')) then -- version 0.1.0 let queued jobs expire
  redis.call('ZREM', EXPIRY, id)
  return 0
end
local owner, expires = field(id, 'owner'), field(id, 'expires_ms')
if tonumber(expires) > NOW then
  redis.call('ZADD', EXPIRY, expires, id)
  return 0
end
clear(id)
redis.call('DEL', JOB .. id)
redis.call('HSET', JOB .. id, 'id', id, 'owner', owner, 'state', 'expired', 'expires_ms', expires)
redis.call('PEXPIRE', JOB .. id, tombstone_ms)
return 1
