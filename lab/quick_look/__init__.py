"""What an operator sees while a session captures: a frame's histogram, and curves that grow with the captures. Cheap
estimates for the eye; the fits of `lab.fit` are what counts."""
