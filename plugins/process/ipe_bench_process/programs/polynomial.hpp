// The bench's model `polynomial` once more: h = u + s u^2 / 2 + s^2 u^3 / 6 of u = sum_j T_j(t) x_j, T Chebyshev's.
#include "ipebench.hpp"
struct Polynomial {
  int n, m;
  double s;
  Vec T;  // (m, n)
  explicit Polynomial(const Blocks& p) : n(p["n"][0]), m(p["m"][0]), s(p["option.strength"][0]) {
    for (double t : p["index.time"]) for (int j = 0; j < n; j++)
      T.push_back(j == 0 ? 1 : j == 1 ? t : 2 * t * T[T.size() - 1] - T[T.size() - 2]);
  }
  double reading(const Vec& x, int k, double* H) const {  // h, and its slopes H (n), of reading k
    double u = 0;
    for (int j = 0; j < n; j++) u += T[k * n + j] * x[j];
    for (int j = 0; j < n; j++) H[j] = (1 + s * u + s * u * s * u / 2) * T[k * n + j];
    return u * (1 + s * u / 2 * (1 + s * u / 3));
  }
};
inline Vec simulate(const Blocks& p, const Vec& x) {
  static const Polynomial model(p);
  Vec h, H(model.n);
  for (int k = 0; k < model.m; k++) h.push_back(model.reading(x, k, H.data()));
  return h;
}
inline Vec jacobian(const Blocks& p, const Vec& x) {
  static const Polynomial model(p);
  Vec J(model.m * model.n);
  for (int k = 0; k < model.m; k++) model.reading(x, k, &J[k * model.n]);
  return J;
}
inline void write_cost(double evaluations) { write("simulations", {evaluations}); write("jacobians", {evaluations}); }
