"""What runs without rlcli: templates that an export writes beside the policy, or as the policy.

They import nothing of rlcli and are ordinary Python, so that they are formatted, checked and tested as such.
"""
