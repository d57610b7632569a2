"""Document 003 (Woo et al. 2018): baseline and LSTM residual from sea trials of a WAM-V."""
