"""Where alarms go: an outbox that outlives the program, and who takes from it to the outside."""
