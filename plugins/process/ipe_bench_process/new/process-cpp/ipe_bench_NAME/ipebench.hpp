// Blocks of numbers, read and written: all that a program needs to take part. C++11, no library.
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <map>
#include <string>
#include <vector>
typedef std::vector<double> Vec;
struct Blocks : std::map<std::string, Vec> {
  const Vec& operator[](const std::string& name) const {  // one that the problem lacks ends the program with a line
    if (!count(name)) { std::cerr << "needs " << name << ", which this problem does not have\n"; std::exit(1); }
    return at(name);
  }
};
inline bool read_block(std::string& name, Vec& v) {  // false at "end" and at the end of input
  size_t count;
  if (!(std::cin >> name) || name == "end" || !(std::cin >> count)) return false;
  v.resize(count);
  std::string word;  // by strtod: streams do not read "NaN" and "Inf"
  for (double& e : v) { std::cin >> word; e = std::strtod(word.c_str(), nullptr); }
  return true;
}
inline Blocks read_blocks() { Blocks b; std::string name; Vec v; while (read_block(name, v)) b.insert({name, v}); return b; }
inline Blocks read_problem() { std::string line; std::getline(std::cin, line); return read_blocks(); }
inline void write(const char* name, const Vec& v) {
  std::printf("%s %zu\n", name, v.size());
  for (double e : v) std::printf("%.17g ", e);
  std::printf("\n");
}
inline void end() { std::printf("end\n"); std::fflush(stdout); }
inline Vec ask(const char* what, const Vec& x) {  // the bench's model: "simulate" or "jacobian"
  write(what, x); std::fflush(stdout);
  std::string name; Vec v;
  if (!read_block(name, v)) std::exit(0);
  return v;
}
