"""Methods as compositions of parts: from a recipe and a configuration to the phases of a run."""
