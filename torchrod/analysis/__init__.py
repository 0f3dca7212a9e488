"""Questions beyond one fit: how many loads, what noise, what is wrong, which robot, and what markers can see at all."""
