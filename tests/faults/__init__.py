"""What a run leaves behind when it is disturbed: signals, several writers, and a long time in one process."""
