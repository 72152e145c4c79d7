"""The tests: a regular package, as installed peers may bring a package `tests` of their own, which would go before one
without this file."""
