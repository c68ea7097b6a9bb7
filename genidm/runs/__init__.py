"""From a method to its row of Table 1: what is run, in which stages, from the command line."""
