"""What a person runs: the `safe-envs` command."""

if __name__ == "scripts":  # imported through the link at the top level of a checkout
    from safe_envs.checkout_links import redirect

    redirect(__name__)
