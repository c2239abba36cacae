"""Who acts in which episode: the protocol, guided and paced episodes, labels as a prior, a critic that compares."""
