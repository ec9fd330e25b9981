"""What an artefact of the thesis is, how its results are stored, judged and shown."""
