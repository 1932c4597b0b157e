"""What is known of people's tissues beforehand: values of the literature, and priors from people's legs."""

from .people import LITERATURE, POPULATION, PRIORS, SOURCE, TISSUES, of_tissues

__all__ = ["LITERATURE", "POPULATION", "PRIORS", "SOURCE", "TISSUES", "of_tissues"]
