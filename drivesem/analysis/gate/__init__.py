"""Whether a new detector fails more often around known failures than the old one: for a team's own CI."""
