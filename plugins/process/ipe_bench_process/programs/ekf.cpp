// An extended Kalman filter for `polynomial`: one scalar reading after another.
#include "polynomial.hpp"
int main() {
  const Blocks p = read_problem();
  const Polynomial model(p);
  const int n = model.n, m = model.m;
  const Vec &sigma = p["sigma"], &prior = p["prior"];
  for (Blocks b; !(b = read_blocks()).empty();) {
    Vec x = p["nominal"], P(n * n, 0.0), H(n), PH(n);
    for (int a = 0; a < n; a++) P[a * n + a] = prior[a] * prior[a];
    double nis = 0;
    for (int k = 0; k < m; k++) {
      double y = b["z"][k] - model.reading(x, k, H.data()), S = sigma[k] * sigma[k];
      for (int a = 0; a < n; a++) { PH[a] = 0; for (int c = 0; c < n; c++) PH[a] += P[a * n + c] * H[c]; S += H[a] * PH[a]; }
      nis += y * y / S / m;
      for (int a = 0; a < n; a++) { x[a] += PH[a] / S * y; for (int c = 0; c < n; c++) P[a * n + c] -= PH[a] * PH[c] / S; }
    }
    write("x", x); write("P", P); write("status", {0}); write("iterations", {double(m)}); write("nis", {nis});
    write_cost(1); end();
  }
}
