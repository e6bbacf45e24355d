"""Commands, one module each: options, one call into the library, and what is printed."""
