// Gauss-Newton for readings whose errors are independent. Replace it by your own, or the model alone.
#include "ipebench.hpp"
#include <cmath>
// The model is the bench's. One of your own reads its constants from the problem p, and says what it cost.
static Vec simulate(const Blocks&, const Vec& x) { return ask("simulate", x); }
static Vec jacobian(const Blocks&, const Vec& x) { return ask("jacobian", x); }
static void write_cost(double) {}
static Vec inverse(Vec A, int n) {  // of a symmetric positive matrix, by Gauss-Jordan
  for (int p = 0; p < n; p++) {
    double d = A[p * n + p];
    for (int j = 0; j < n; j++) A[p * n + j] = j == p ? 1 / d : A[p * n + j] / d;
    for (int i = 0; i < n; i++) if (i != p) {
      double f = A[i * n + p]; A[i * n + p] = 0;
      for (int j = 0; j < n; j++) A[i * n + j] -= f * A[p * n + j];
    }
  }
  for (int i = 0; i < n; i++) for (int j = 0; j < i; j++) A[i * n + j] = A[j * n + i];
  return A;
}
int main() {
  const Blocks p = read_problem();
  const int n = p["n"][0], m = p["m"][0];
  const Vec& sigma = p["sigma"];
  for (Blocks b; !(b = read_blocks()).empty();) {
    const Vec& z = b["z"];
    Vec x = p["nominal"], P;
    double status = 2, i = 0;
    for (; i < 50; i++) {
      Vec h = simulate(p, x), J = jacobian(p, x), A(n * n, 0.0), g(n, 0.0);
      for (int k = 0; k < m; k++) for (int a = 0; a < n; a++) {
        double w = J[k * n + a] / (sigma[k] * sigma[k]);
        g[a] += w * (z[k] - h[k]);
        for (int c = 0; c < n; c++) A[a * n + c] += w * J[k * n + c];
      }
      P = inverse(A, n);
      double size = 0;  // of the step in standard deviations, squared
      Vec dx(n, 0.0);
      for (int a = 0; a < n; a++) { for (int c = 0; c < n; c++) dx[a] += P[a * n + c] * g[c]; size += dx[a] * g[a]; }
      if (!std::isfinite(size)) { status = 4; break; }
      if (std::sqrt(size) < 1e-6) { status = 0; break; }
      for (int a = 0; a < n; a++) x[a] += dx[a];
    }
    write("x", x); write("P", P); write("status", {status}); write("iterations", {i});
    write_cost(i + 1); end();
  }
}
