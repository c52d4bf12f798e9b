"""The rounds of a run: propose pairs, register them, solve and judge, whoever proposes."""
