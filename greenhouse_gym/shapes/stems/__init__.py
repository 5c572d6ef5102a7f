"""Stems: main stems, strings, peduncles, pedicels and pipes, as chains of capsules."""
