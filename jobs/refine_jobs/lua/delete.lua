-- A job is removed for good, unless a worker holds it. ARGV: id, RQ's list, commands that take it
-- out there.
-- Returns deleted, held, or gone if somebody else was faster.
local id = ARGV[1]
local state = field(id, 'state')
if not state or state == 'expired' then
  return 'gone'
end
if state ~= 'queued' and not has_ended(state) then
  return 'held'
end
if state == 'queued' then
  refund(id, ARGV[2])
end
clear(id)
redis.call('DEL', JOB .. id)
drop_webhook(id)
run_commands(3)
return 'deleted'
