-- Shared by all scripts; scripts.py puts the constants of keys.py above it and one script below it.
-- README.md draws the state machine. end_job is the only way into a terminal state.

local function server_time()
  local time = redis.call('TIME')
  return time[1] * 1000 + math.floor(time[2] / 1000)
end

local NOW = tonumber(KEYS[1]) or server_time() -- milliseconds; KEYS[1]: a clock of the caller's (scripts.py)

local function field(id, name)
  return redis.call('HGET', JOB .. id, name)
end

local function emit(id, type, state, ...)
  local sequence = redis.call('HINCRBY', JOB .. id, 'sequence', 1)
  redis.call('XADD', EVENTS .. id, 'MAXLEN', EVENTS_KEPT, sequence .. '-0',
    'type', type, 'state', state, 'time', NOW, ...)
  redis.call('PUBLISH', DOORBELL, id)
end

local function set_state(id, state)
  redis.call('HSET', JOB .. id, 'state', state)
  emit(id, 'state', state)
end

local function enter_queue(id)
  redis.call('ZADD', QUEUED, field(id, 'number'), id)
  redis.call('ZADD', QUEUED_SINCE, NOW, id)
  redis.call('HINCRBY', QUEUED_BY_OWNER, field(id, 'owner'), 1)
end

local function leave_queue(id)
  redis.call('HDEL', MISSING, id)
  redis.call('ZREM', QUEUED_SINCE, id)
  if redis.call('ZREM', QUEUED, id) == 1 then
    local owner = field(id, 'owner')
    if redis.call('HINCRBY', QUEUED_BY_OWNER, owner, -1) <= 0 then
      redis.call('HDEL', QUEUED_BY_OWNER, owner)
    end
  end
end

-- A duration in milliseconds into the histogram `name` of METRICS.
local function observe(name, duration)
  local bucket = 'inf'
  for bound in string.gmatch(BUCKETS_S, '%S+') do
    if duration <= tonumber(bound) * 1000 then
      bucket = bound
      break
    end
  end
  redis.call('HINCRBY', METRICS, name .. ':' .. bucket, 1)
  redis.call('HINCRBY', METRICS, name .. ':sum_ms', duration)
end

local function is_held(state)
  return state == 'running' or state == 'cancelling'
end

local function has_ended(state)
  return state == 'succeeded' or state == 'failed' or state == 'cancelled'
end

-- Why one more job of the owner cannot be queued, or nothing.
local function no_room(owner, max_queued, max_queued_per_owner)
  if redis.call('ZCARD', QUEUED) >= tonumber(max_queued) then
    return 'queue_full'
  end
  if tonumber(redis.call('HGET', QUEUED_BY_OWNER, owner) or 0) >= tonumber(max_queued_per_owner) then
    return 'quota'
  end
end

-- Whether `attempt` is the worker that holds the job now. A worker that lost its lease is told so and writes nothing.
local function holds(id, attempt)
  return field(id, 'attempt') == attempt and is_held(field(id, 'state'))
end

-- The webhook of a job that ends in this state goes to the outbox: with the state or not at all.
local function post(id, state)
  local webhook = cjson.decode(field(id, 'spec')).webhook
  for _, event in ipairs(webhook and webhook.events or {}) do
    if event == state then
      redis.call('HSET', WEBHOOK .. id, 'id', id, 'owner', field(id, 'owner'), 'url', webhook.url,
        'state', state, 'ended_ms', NOW, 'attempt', 0)
      redis.call('ZADD', OUTBOX, NOW, id)
    end
  end
end

local function drop_webhook(id)
  redis.call('ZREM', OUTBOX, id)
  redis.call('DEL', WEBHOOK .. id)
end

local function end_job(id, state, reason, retention_ms)
  local started = field(id, 'started_ms')
  if started then
    observe('run_s', NOW - started)
  end
  redis.call('HINCRBY', METRICS, 'jobs:' .. state .. ':' .. reason, 1)
  leave_queue(id)
  redis.call('ZREM', LEASES, id)
  local expires = NOW + retention_ms
  redis.call('HSET', JOB .. id, 'state', state, 'finished_ms', NOW, 'expires_ms', expires)
  redis.call('ZADD', EXPIRY, expires, id)
  emit(id, 'completed', state)
  post(id, state)
end

-- Remove everything but the record: the caller deletes it or makes it a tombstone.
local function clear(id)
  local state = field(id, 'state')
  leave_queue(id)
  redis.call('ZREM', EXPIRY, id)
  redis.call('ZREM', OWNER .. field(id, 'owner'), id)
  redis.call('SADD', TRASH, id)
  if state == 'queued' then
    emit(id, 'completed', 'expired')
  end
  redis.call('EXPIRE', EVENTS .. id, LAST_WORDS_S)
end

-- Redis commands from ARGV[first] on, each as its number of words and the words: what RQ would have sent.
local function run_commands(first)
  while first <= #ARGV do
    local words = tonumber(ARGV[first])
    redis.call(unpack(ARGV, first + 1, first + words))
    first = first + words + 1
  end
end

