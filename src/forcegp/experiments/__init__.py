"""The paper's figures and ours: typed configurations -> jobs -> results. Import what you need from its modules."""
