"""The REST service: routes parse, call one verb of `lab`, and return a schema; the operator's page beside it."""
