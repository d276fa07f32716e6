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

-- A number of the record that jobs of former versions do not have.
local function amount(id, name)
  return tonumber(field(id, name) or 0)
end

-- Whether the job is one that people count; a question is not.
local function is_refinement(id)
  return (field(id, 'task') or 'refine') == 'refine'
end

-- ---- the order of the queue: start-time fair queueing, see README.md ----

local function virtual_time()
  return tonumber(redis.call('GET', VIRTUAL_TIME) or 0)
end

local function flow_of(id)
  return field(id, 'flow') or field(id, 'owner')
end

local function enter_queue(id, tag)
  redis.call('ZADD', QUEUED, tag, id)
  redis.call('ZADD', FLOW .. flow_of(id), field(id, 'number'), id)
  redis.call('ZADD', QUEUED_SINCE, NOW, id)
  redis.call('HINCRBY', QUEUED_BY_OWNER, field(id, 'owner'), 1)
  redis.call('INCRBY', QUEUED_COST, amount(id, 'cost_ms'))
end

-- A new job starts after the last one of its flow, and not before the work that has begun.
local function join_flow(id)
  local now, flow = virtual_time(), flow_of(id)
  local start = math.max(now, tonumber(redis.call('ZSCORE', FLOWS, flow) or 0))
  redis.call('ZADD', FLOWS, start + amount(id, 'charge_ms'), flow)
  redis.call('SET', VIRTUAL_TIME, now + 1) -- who comes later stays later
  enter_queue(id, start - amount(id, 'head_start_ms'))
end

-- A job that has begun comes back to its place, or to the front if the others have passed it.
local function rejoin_flow(id)
  enter_queue(id, math.min(amount(id, 'tag'), virtual_time()))
end

local function leave_queue(id)
  redis.call('HDEL', MISSING, id)
  redis.call('ZREM', QUEUED_SINCE, id)
  if redis.call('ZREM', QUEUED, id) == 1 then
    local owner = field(id, 'owner')
    redis.call('ZREM', FLOW .. flow_of(id), id)
    redis.call('DECRBY', QUEUED_COST, amount(id, 'cost_ms'))
    if redis.call('HINCRBY', QUEUED_BY_OWNER, owner, -1) <= 0 then
      redis.call('HDEL', QUEUED_BY_OWNER, owner)
    end
    if redis.call('ZCARD', QUEUED) == 0 then
      redis.call('DEL', FLOWS, QUEUED_COST) -- nobody waits: what anybody has had is forgotten
    end
  end
end

-- The job starts. A flow that the virtual time has passed is like a new one.
local function start_flow(id)
  local tag = tonumber(redis.call('ZSCORE', QUEUED, id))
  local now = math.max(virtual_time(), tag)
  redis.call('HSET', JOB .. id, 'tag', tag)
  redis.call('SET', VIRTUAL_TIME, now)
  redis.call('ZREMRANGEBYSCORE', FLOWS, '-inf', now)
  leave_queue(id)
end

-- RQ's list in the order of QUEUED; what it still has of jobs that no longer wait comes first and does nothing.
local function rearrange(list)
  local queue, waits, deliveries, ordered = redis.call('ZRANGE', QUEUED, 0, -1), {}, {}, {}
  for _, id in ipairs(queue) do
    waits[id] = true
  end
  for _, delivery in ipairs(redis.call('LRANGE', list, 0, -1)) do
    local id = string.match(delivery, '^(.*)-%d+$')
    if waits[id] then
      deliveries[id] = deliveries[id] or {}
      table.insert(deliveries[id], delivery)
    else
      table.insert(ordered, delivery)
    end
  end
  for _, id in ipairs(queue) do
    for _, delivery in ipairs(deliveries[id] or {}) do
      table.insert(ordered, delivery)
    end
  end
  redis.call('DEL', list)
  for first = 1, #ordered, 1000 do -- Lua passes a few thousand words at most
    redis.call('RPUSH', list, unpack(ordered, first, math.min(first + 999, #ordered)))
  end
end

-- A job goes that has not run: what it was charged is given back to those behind it in its flow.
local function refund(id, list)
  local flow, charge = flow_of(id), amount(id, 'charge_ms')
  local behind = redis.call('ZRANGEBYSCORE', FLOW .. flow, '(' .. field(id, 'number'), '+inf')
  for _, other in ipairs(behind) do
    redis.call('ZINCRBY', QUEUED, -charge, other)
  end
  if redis.call('ZSCORE', FLOWS, flow) then
    redis.call('ZINCRBY', FLOWS, -charge, flow)
  end
  leave_queue(id)
  if #behind > 0 then
    rearrange(list)
  end
end

-- ---- ends ----

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

-- How long runs take against what was estimated: a mean that follows.
local function keep_pace(run, cost)
  if cost > 0 then
    local newest = run / cost
    local former = tonumber(redis.call('GET', PACE) or newest)
    redis.call('SET', PACE, 0.8 * former + 0.2 * newest)
  end
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
  if is_refinement(id) then
    if started then
      observe('run_s', NOW - started)
      if state == 'succeeded' then
        keep_pace(NOW - started, amount(id, 'cost_ms'))
      end
    end
    redis.call('HINCRBY', METRICS, 'jobs:' .. state .. ':' .. reason, 1)
  else
    redis.call('HINCRBY', METRICS, 'questions:' .. state .. ':' .. reason, 1)
  end
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


-- RQ's own enqueue, which appends; ARGV from `first` on: its list, the delivery, the commands. Then the delivery
-- moves before that of the next job that RQ still has.
local function enqueue(id, first)
  local list, delivery = ARGV[first], ARGV[first + 1]
  run_commands(first + 2)
  local rank = redis.call('ZRANK', QUEUED, id) + 1
  local next_id = redis.call('ZRANGE', QUEUED, rank, rank)[1]
  if not next_id then
    return
  end
  redis.call('RPOP', list)
  while next_id do
    local pivot = next_id .. '-' .. (field(next_id, 'attempt') + 1)
    if redis.call('LINSERT', list, 'BEFORE', pivot, delivery) > 0 then
      return
    end
    rank = rank + 1
    next_id = redis.call('ZRANGE', QUEUED, rank, rank)[1]
  end
  redis.call('RPUSH', list, delivery)
end
