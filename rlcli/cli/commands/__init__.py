"""Commands of `rlcli`, one module each: it declares the options, calls the library, and prints the result."""
