"""Files damaged at random, on purpose, and given to every reader of `splatseg.io`.

`targets` has a function for each format, `mutations` the ways in which files are damaged, `worker`
the process that reads them under limits of memory and time, and `run` starts these and counts.
`scripts/fuzz` is the command.
"""
