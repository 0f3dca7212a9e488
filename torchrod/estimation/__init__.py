"""From a model and its measurements to an estimate: the filter's algebra, evaluators, starts, the solver and its result."""
