"""The command line of rlcli: main function (`app`), one module for each command (`commands`), output (`ui`)."""
