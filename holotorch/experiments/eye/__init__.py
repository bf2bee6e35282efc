"""What an observer sees of a volume's hologram."""
