-- Somebody asks for a job to stop. ARGV: id, retention_ms, RQ's list, commands that take it out there. Returns the new state.
local id, retention_ms = unpack(ARGV, 1, 2)
local state = field(id, 'state')
if state == 'queued' then
  refund(id, ARGV[3])
  end_job(id, 'cancelled', '', retention_ms)
  run_commands(4)
  return 'cancelled'
elseif state == 'running' then
  set_state(id, 'cancelling')
  return 'cancelling'
end
return state
