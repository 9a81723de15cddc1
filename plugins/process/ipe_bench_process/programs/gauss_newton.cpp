// Gauss-Newton with its own simulation of `polynomial`.
#include "polynomial.hpp"
#include <cmath>
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
  const Polynomial model(p);
  const int n = model.n, m = model.m;
  const Vec& sigma = p["sigma"];
  for (Blocks b; !(b = read_blocks()).empty();) {
    const Vec& z = b["z"];
    Vec x = p["nominal"], P;
    double status = 2, i = 0;
    for (; i < 50; i++) {
      Vec h(m), J(m * n), A(n * n, 0.0), g(n, 0.0);
      for (int k = 0; k < m; k++) h[k] = model.reading(x, k, &J[k * n]);
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
    write("simulations", {i + 1}); write("jacobians", {i + 1}); end();
  }
}
