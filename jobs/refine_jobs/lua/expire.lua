-- A job past its lifetime becomes a tombstone. ARGV: id, tombstone_ms, commands that take it out of RQ.
-- Returns 1 if it did.
local id, tombstone_ms = unpack(ARGV, 1, 2)
local state, expires = field(id, 'state'), field(id, 'expires_ms')
if is_held(state) then -- its end sets a new lifetime
  redis.call('ZADD', EXPIRY, NOW + 60000, id)
  return 0
end
if not expires or tonumber(expires) > NOW then
  redis.call('ZREM', EXPIRY, id)
  return 0
end
local owner = field(id, 'owner')
clear(id)
redis.call('DEL', JOB .. id)
redis.call('HSET', JOB .. id, 'id', id, 'owner', owner, 'state', 'expired', 'expires_ms', expires)
redis.call('PEXPIRE', JOB .. id, tombstone_ms)
run_commands(3)
return 1
