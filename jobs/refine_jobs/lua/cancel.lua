-- Somebody asks for a job to stop. ARGV: id, retention_ms, commands that take it out of RQ. Returns the new state.
local id, retention_ms = unpack(ARGV, 1, 2)
local state = field(id, 'state')
if state == 'queued' then
  end_job(id, 'cancelled', '', retention_ms)
  run_commands(3)
  return 'cancelled'
elseif state == 'running' then
  set_state(id, 'cancelling')
  return 'cancelling'
end
return state
