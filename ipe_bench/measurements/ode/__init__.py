"""Defines measurement models by ordinary differential equations, on a compiled batched integrator.

A model is one class, `OdeMeasurement`, whose docstring has an example.

`start`, `rhs` and `read` are called with unknown quantities in place of numbers, once, and what
they do is recorded: they may use + - * / **, NumPy's sin cos tan arctan exp log sqrt sinh cosh
tanh, arctan2 hypot sign floor mod, comparisons, np.where, np.minimum and np.maximum, loops of fixed
length, and anything else that does not ask for a value (no if, no array of floats that is filled
with results). A comparison is the number 0 or 1, as in a formula: + counts those that hold, where
NumPy's would be their `or`. From the recording come machine code for whole batches and the exact
Jacobian; nothing else is to be written. `cases` adds experiments that share the parameters and
differ in constants c, `driven` constants that change with time, and `si_sizes` the sizes of
parameters that are shown in other units.

The method is of eighth order. Each trial's step follows from its own parameters: it is halved until
half the step shows that the readings hold `tolerance`, and the Jacobian uses the same. `step` fixes
it for all trials instead, and `fastest_rate` may say where the search begins. `gins` is a large
model of this kind; small ones need no Python: see `described`.
"""
