-- An attempt to deliver a webhook has ended. ARGV: id, attempt, what came of it (JSON), retry_ms or '' if there is
-- no further attempt, body. Returns 1, or 0 if another service has taken it since, or it was deleted.
local id, attempt, delivery, retry_ms, body = unpack(ARGV)
if redis.call('HGET', WEBHOOK .. id, 'attempt') ~= attempt then
  return 0
end
local state = field(id, 'state')
if state and state ~= 'expired' then
  local before = field(id, 'webhook_deliveries')
  redis.call('HSET', JOB .. id, 'webhook_deliveries',
    before and string.sub(before, 1, -2) .. ',' .. delivery .. ']' or '[' .. delivery .. ']')
end
if retry_ms == '' then
  drop_webhook(id)
else
  redis.call('HSET', WEBHOOK .. id, 'body', body)
  redis.call('ZADD', OUTBOX, NOW + retry_ms, id)
end
return 1
