//! Frames out: ZeroMQ, EXR, PNG, records.
//!
//! In: finished frames. Out: files and messages. Failure stays here: a slow subscriber or a full disk never stops the cycle.
