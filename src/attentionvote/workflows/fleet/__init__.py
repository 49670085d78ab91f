"""One model a part, and a leaderboard."""
