"""genidm: goal-directed locomotion learned from experience that was never goal-directed."""
