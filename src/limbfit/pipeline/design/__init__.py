"""Which sites and records would determine the parameters: the experiments ``design`` and ``protocol``."""
