-- The upload `id` becomes a queued job, in one step with idempotency, bounds and RQ's own enqueue commands.
-- ARGV: id, owner, idempotency key or '', fingerprint, idempotency_ms, max_queued, max_queued_per_owner,
--       retention_ms, number of words of the record, field, value, ..., RQ's enqueue
-- Returns {outcome, id of the job}; outcome: created, replayed, reused, queue_full, quota, upload_gone.
local id, owner, key, fingerprint = unpack(ARGV, 1, 4)

local function refuse(outcome, other)
  redis.call('SADD', TRASH, id)
  return { outcome, other or '' }
end

if redis.call('ZREM', UPLOADS, id) == 0 then
  return refuse('upload_gone')
end
if key ~= '' then
  local known_id, known_fingerprint = string.match(redis.call('GET', key) or '', '^(%S+) (%S+)$')
  local state = known_id and field(known_id, 'state')
  if state and state ~= 'expired' then
    return refuse(known_fingerprint == fingerprint and 'replayed' or 'reused', known_id)
  end
end
local refusal = no_room(owner, ARGV[6], ARGV[7])
if refusal then
  return refuse(refusal)
end

if key ~= '' then
  redis.call('SET', key, id .. ' ' .. fingerprint, 'PX', ARGV[5])
end
local number = redis.call('INCR', SUBMISSIONS)
local words = tonumber(ARGV[9])
redis.call('HSET', JOB .. id, unpack(ARGV, 10, 9 + words))
redis.call('HSET', JOB .. id, 'id', id, 'owner', owner, 'number', number, 'attempt', 0,
  'created_ms', NOW, 'expires_ms', NOW + ARGV[8]) -- not sooner: its end sets the time
redis.call('ZADD', OWNER .. owner, number, id)
join_flow(id)
set_state(id, 'queued')
enqueue(id, 10 + words)
redis.call('HINCRBY', METRICS, 'submitted:' .. (is_refinement(id) and 'refinements' or 'questions'), 1)
return { 'created', id }
