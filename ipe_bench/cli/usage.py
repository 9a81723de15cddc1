"""What `ipe-bench COMMAND --help` prints. `run` is not here: Hydra writes its help, with all options there are."""

USAGE = {
    "estimate": """\
ipe-bench estimate: parameters from real readings, and whether the model fits them

  ipe-bench estimate readings=FILE.csv                          the default model, gins
  ipe-bench estimate measurement=ranging readings=FILE.parquet
  ipe-bench estimate measurement=gins readings=FILE.csv "solver=[newton]" "baseline=[gauss_newton,ekf]"
  ipe-bench estimate measurement=nist/misra1a                   readings that come with the model

readings=FILE       CSV or Parquet; `ipe-bench list measurement -v` says which rows and columns a model wants.
                    A missing reading keeps its row, with an empty cell.
noise.deviation=X   the standard deviation of a reading; standard errors and tests rest on it.
error_scale=X       how far the parameters may lie from the nominal point: the prior of filters and map_lm.
output=DIR          where the files go: outputs/estimate-MODEL unless given, or outputs/estimate-MODEL-2 and so on
                    where another command has written there. Nothing of another command is overwritten.

Files: estimate.json (estimates, standard errors, correlations, tests, versions), residuals.csv, and as PNG and PDF
residuals (normalised, by time) and ellipses (95 % regions of the most correlated pairs of parameters).
Exit codes: 0 an estimator converged; 1 none did; 2 a mistake in what was asked for, or in the file.
""",
    "report": """\
ipe-bench report: tables, figures and report of what is stored; nothing is computed again

  ipe-bench report DIR                            into DIR itself
  ipe-bench report DIR1 DIR2 output=DIR           several directories together, into DIR

Exit codes: 0 done; 1 done, but something that was asked for is missing; 2 a mistake in what was asked for.
""",
    "status": """\
ipe-bench status: what is done, missing, failed and stale in directories of results

  ipe-bench status DIR [DIR ...]

Exit codes: 0 complete; 1 not complete; 2 a mistake in what was asked for.
""",
    "list": """\
ipe-bench list: what there is to choose from, and where it comes from

  ipe-bench list                                  all groups
  ipe-bench list solver baseline                  some groups
  ipe-bench list measurement -v                   with each model's parameters and the columns of its readings file
""",
    "new": """\
ipe-bench new: a working plugin to start from, in plugins/NAME

  ipe-bench new KIND NAME                         KIND is solver, baseline, measurement or noise
""",
    "check": """\
ipe-bench check: whether a plugin keeps the promises that every component makes

  ipe-bench check plugins/NAME [...]

Exit codes: 0 all checks passed; 1 some failed; 2 a mistake in what was asked for.
""",
}
