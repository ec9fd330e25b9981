"""`python -m safe_envs`: the same as the command `safe-envs`.

This is an entry point and no part of the library: here alone a lower layer imports the highest one,
when it is run.
"""

if __name__ == "__main__":
    from safe_envs.scripts.cli import main

    main()
