"""The paper's figures and ours: typed configurations -> cells -> results. Import what you need from its modules."""
