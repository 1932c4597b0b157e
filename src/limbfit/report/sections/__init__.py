"""The sections of the report, each made from the store; what is not stored is said in a sentence."""
