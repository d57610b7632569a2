"""From the topics of a recording to one log on one clock."""
