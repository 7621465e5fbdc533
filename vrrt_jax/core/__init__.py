"""The batched expansion kernel that every planner runs on."""
