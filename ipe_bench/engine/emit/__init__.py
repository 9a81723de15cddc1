"""Writes modules of LLVM's intermediate representation, of which `engine.compiled` makes machine
code; imported only where something is compiled.

Every operation is IEEE arithmetic in a fixed order, so the bits of a lane do not depend on the
number of lanes.
"""

from ipe_bench.engine.emit.integrator import integrate
from ipe_bench.engine.emit.rows import rates, rows
from ipe_bench.engine.emit.scan import scan

__all__ = ["integrate", "rates", "rows", "scan"]
