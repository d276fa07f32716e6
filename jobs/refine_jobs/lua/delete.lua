-- A job is removed for good, unless a worker holds it. ARGV: id, commands that take it out of RQ. Returns 1 if it was.
local id = ARGV[1]
if is_held(field(id, 'state')) then
  return 0
end
clear(id)
redis.call('DEL', JOB .. id)
run_commands(2)
return 1
