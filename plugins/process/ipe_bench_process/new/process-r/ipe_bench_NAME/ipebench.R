# Blocks of numbers, read and written: all that a program needs to take part.
input <- file("stdin", "r")
read_block <- function() {  # NULL at "end" and at the end of input
  while (identical(s <- readLines(input, 1), "")) {}
  if (!length(s) || s == "end") return(NULL)
  list(name = sub(" .*", "", s), v = scan(text = readLines(input, 1), quiet = TRUE))
}
read_blocks <- function() { b <- list(); while (!is.null(k <- read_block())) b[[k$name]] <- k$v; b }
put <- function(name, v) cat(name, " ", length(v), "\n", paste(sprintf("%.17g", v), collapse = " "), "\n", sep = "")
ask <- function(what, x) {  # the bench's model: "simulate" or "jacobian"
  put(what, x); flush(stdout())
  if (is.null(k <- read_block())) quit("no")
  k$v
}
