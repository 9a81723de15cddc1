# Gauss-Newton on the bench's model, for readings whose errors are independent. Replace it by your own.
source("ipebench.R")
invisible(readLines(input, 1)); p <- read_blocks()
while (length(b <- read_blocks())) {
  x <- p$nominal; status <- 2
  for (i in 0:49) {
    h <- ask("simulate", x); J <- matrix(ask("jacobian", x), p$m, p$n, byrow = TRUE) / p$sigma
    P <- solve(t(J) %*% J); g <- t(J) %*% ((b$z - h) / p$sigma); dx <- as.vector(P %*% g); step <- sqrt(sum(dx * g))
    if (!is.finite(step)) { status <- 4; break }
    if (step < 1e-6) { status <- 0; break }
    x <- x + dx
  }
  put("x", x); put("P", (P + t(P)) / 2); put("status", status); put("iterations", i); cat("end\n"); flush(stdout())
}
