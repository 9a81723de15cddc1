"""A plugin for ipe-bench: the cost by which nearly all trials are done, for who has a deadline to
keep."""
