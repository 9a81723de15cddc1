"""Integrates differential equations with their tangents in machine code. It knows nothing of a
bench.

Equations are functions of expressions, recorded once; a `Kernel` of them integrates many trials at
a time. A `RowFunction` runs a recorded function on many rows of numbers, and a `Step` along epochs.
"""
