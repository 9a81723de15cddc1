% Gauss-Newton on the bench's model, for readings whose errors are independent. Replace it by your own.
source("ipebench.m");
fgetl(stdin); p = read_blocks();
while isfield(b = read_blocks(), "z")
  x = p.nominal; status = 2;
  for i = 0:49
    h = ask("simulate", x); J = reshape(ask("jacobian", x), p.n, p.m)' ./ p.sigma;
    P = inv(J' * J); g = J' * ((b.z - h) ./ p.sigma); dx = P * g; step = sqrt(dx' * g);
    if ! isfinite(step), status = 4; break; end
    if step < 1e-6, status = 0; break; end
    x += dx;
  end
  put("x", x); put("P", (P + P') / 2); put("status", status); put("iterations", i); puts("end\n"); fflush(stdout);
end
