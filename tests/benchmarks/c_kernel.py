"""A rival for the generated integrator: the same formula and steps in C, eight problems to a vector, by the compiler's
own vector types and nothing else around it. It is written here from a model's equations and compiled on the spot."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.ode.model import OdeMeasurement
from ipe_bench.measurements.ode.plan import _Tape
from ipe_bench.measurements.ode.tableau import DOP853
from ipe_bench.measurements.ode.trace import Program

LANES = 8
FLAGS = ("-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-shared", "-fPIC")
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
_FUSED = {"fma": "{0} * {1} + {2}", "fms": "{0} * {1} - {2}", "fnma": "{2} - {0} * {1}", "neg": "-{0}"}


def compiler() -> str | None:
    return shutil.which("gcc")


def simulator(model: OdeMeasurement, steps: int):
    """simulate(x) with this many equal steps between readings, as compiled C on one thread."""
    folder = Path(tempfile.mkdtemp(prefix="ipe-bench-c-"))
    (folder / "kernel.c").write_text(source(model, steps))
    found = compiler()
    assert found is not None
    subprocess.run([found, *FLAGS, "-o", folder / "kernel.so", folder / "kernel.c", "-lm"], check=True)
    integrate = ctypes.CDLL(str(folder / "kernel.so")).integrate
    pointer = ctypes.POINTER(ctypes.c_double)
    integrate.argtypes = [pointer, ctypes.c_long, pointer]

    def simulate(x: Array) -> Array:
        x, z = np.ascontiguousarray(x), np.empty((len(x), model.m))
        integrate(x.ctypes.data_as(pointer), len(x), z.ctypes.data_as(pointer))
        return z

    return simulate


def source(model: OdeMeasurement, steps: int) -> str:
    tape = _Tape(model._equations)
    fixed = tape.fixed(*tape.slope, *tape.shown)
    slope = Program.of(tape.slope, [tape.t, *tape.y, *fixed])
    shown = Program.of(tape.shown, [tape.t, *tape.y, *fixed])
    begin = Program.of([*tape.start, *fixed], [*tape.p, *tape.c])
    n, states, outputs, cases = model.n, model.states, len(model.outputs), model.cases
    times, stages = model.times, len(DOP853.B)
    stage = "\n".join(_stage(s, states) for s in range(stages))
    end = "\n".join(f"y[{i}] += h * ({_sum(DOP853.B, i)});" for i in range(states))
    return f"""
typedef double V __attribute__((vector_size({8 * LANES})));
static const double CASES[{len(cases)}][{max(1, cases.shape[1])}] = {_array(cases)};
static const double TIMES[] = {_array(times)};
static const double OFFSET[] = {_array(model.offset)};
static const double SIZES[] = {_array(model.si_sizes)};

{_function("slope", "V", slope, 1 + states + len(fixed))}
{_function("shown", "V", shown, 1 + states + len(fixed))}
{_function("begin", "double", begin, n + cases.shape[1])}

void integrate(const double *x, long trials, double *z) {{
  long problems = trials * {len(cases)};
  for (long group = 0; group < problems; group += {LANES}) {{
    V in[{1 + states + len(fixed)}], y[{states}], k[{stages}][{states}], out[{outputs}];
    for (int lane = 0; lane < {LANES}; lane++) {{
      long problem = group + lane < problems ? group + lane : problems - 1;
      double given[{n + cases.shape[1]}], first[{states + len(fixed)}];
      for (int i = 0; i < {n}; i++) given[i] = x[problem / {len(cases)} * {n} + i] * SIZES[i];
      for (int i = 0; i < {cases.shape[1]}; i++) given[{n} + i] = CASES[problem % {len(cases)}][i];
      begin(given, first);
      for (int i = 0; i < {states}; i++) y[i][lane] = first[i];
      for (int i = 0; i < {len(fixed)}; i++) in[{1 + states} + i][lane] = first[{states} + i];
    }}
    double t = 0;
    for (int r = 0; r < {len(times)}; r++) {{
      double h = (TIMES[r] - t) / {steps};
      for (int s = 0; s < {steps}; s++) {{
{stage}
{end}
        t += h;
      }}
      t = TIMES[r];
      in[0] = (V){{}} + t;
      for (int i = 0; i < {states}; i++) in[1 + i] = y[i];
      shown(in, out);
      for (int lane = 0; lane < {LANES} && group + lane < problems; lane++)
        for (int i = 0; i < {outputs}; i++) {{
          long place = ((group + lane) % {len(cases)} * {len(times)} + r) * {outputs} + i;
          z[(group + lane) / {len(cases)} * {model.m} + place] = out[i][lane] - OFFSET[place];
        }}
    }}
  }}
}}
"""


def _stage(s: int, states: int) -> str:
    moved = "\n".join(f"in[{1 + i}] = y[{i}] + h * ({_sum(DOP853.A[s], i)});" for i in range(states))
    return f"in[0] = (V){{}} + (t + {DOP853.C[s]!r} * h);\n{moved}\nslope(in, k[{s}]);"


def _sum(weights, i: int) -> str:
    return " + ".join(f"{w!r} * k[{j}][{i}]" for j, w in enumerate(weights) if w) or "(V){}"


def _array(values) -> str:
    return "{" + ", ".join(_array(v) if np.ndim(v) else repr(float(v)) for v in values) + "}"


def _function(name: str, kind: str, program: Program, inputs: int) -> str:
    assert program.inputs == inputs
    lines = [f"{kind} v{i} = in[{i}];" for i in range(inputs)]
    for i, (operation, *numbers) in enumerate(program.operations, start=inputs):
        if operation == "constant":
            value = f"({kind}){{}} + {numbers[0]!r}" if kind == "V" else repr(numbers[0])
        elif operation in _INFIX:
            value = f"v{numbers[0]} {_INFIX[operation]} v{numbers[1]}"
        elif operation in _FUSED:
            value = _FUSED[operation].format(*(f"v{j}" for j in numbers))
        elif kind == "double":
            value = f"__builtin_{operation}(v{numbers[0]})"
        else:
            lanes = ", ".join(f"__builtin_{operation}(v{numbers[0]}[{lane}])" for lane in range(LANES))
            value = f"(V){{{lanes}}}"
        lines.append(f"{kind} v{i} = {value};")
    lines += [f"out[{i}] = v{j};" for i, j in enumerate(program.outputs)]
    return f"static inline void {name}(const {kind} *in, {kind} *out) {{\n" + "\n".join(lines) + "\n}"
