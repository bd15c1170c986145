//! The `rit.v1` gRPC packages (see the .proto files beside this crate) and the ways to reach them.

pub mod snapshot;
pub mod transport;

/// The detail of a [`v1::Loss`] is shown to people: its longest, in characters. The actor cuts it, and the learner again.
pub const LOSS_DETAIL_CHARS_MAX: usize = 500;

/// Generated from `rit/v1/*.proto`, where every message is documented.
#[allow(missing_docs, unused_qualifications, clippy::all, reason = "generated code")]
pub mod v1 {
    tonic::include_proto!("rit.v1");
}

/// A run's state as JSON has it: `"running"`, `"paused"`, `"stopping"`.
fn state_name<S: serde::Serializer>(state: &i32, serializer: S) -> Result<S::Ok, S::Error> {
    let state = v1::RunState::try_from(*state).unwrap_or_default();
    let name = state.as_str_name().trim_start_matches("RUN_STATE_").to_ascii_lowercase();
    serializer.serialize_str(&name)
}
