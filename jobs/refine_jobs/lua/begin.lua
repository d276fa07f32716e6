-- An upload begins, if there is room for one more job. ARGV: id, owner, max_queued, max_queued_per_owner.
-- Returns begun, queue_full or quota.
local id, owner, max_queued, max_queued_per_owner = unpack(ARGV)
local refusal = no_room(owner, max_queued, max_queued_per_owner)
if refusal then
  return refusal
end
redis.call('ZADD', UPLOADS, NOW, id)
return 'begun'
