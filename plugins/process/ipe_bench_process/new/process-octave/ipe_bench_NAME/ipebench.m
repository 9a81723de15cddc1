% Blocks of numbers, read and written: all that a program needs to take part.
1;
function b = read_blocks()  % up to "end"; "index.time" becomes index_time
  b = struct();
  while ischar(s = fgetl(stdin)) && ! strcmp(s, "end")
    if isempty(s), continue; end
    b.(strrep(strtok(s), ".", "_")) = sscanf(fgetl(stdin), "%f");
  end
end
function put(name, v)
  printf("%s %d\n", name, numel(v)); printf("%.17g ", v); printf("\n");
end
function v = ask(what, x)  % the bench's model: "simulate" or "jacobian"
  put(what, x); fflush(stdout);
  while ischar(s = fgetl(stdin)) && isempty(s), end
  if ! ischar(s), exit; end
  v = sscanf(fgetl(stdin), "%f");
end
