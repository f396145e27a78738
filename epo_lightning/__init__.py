"""Energy-based potential games (EPO) for multi-agent motion forecasting."""
