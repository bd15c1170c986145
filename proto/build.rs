//! Generates the rit.v1 types. `protox` compiles the .proto files, so no system `protoc` is needed.

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let files =
        ["rit/v1/weights.proto", "rit/v1/rollout.proto", "rit/v1/episodes.proto", "rit/v1/control.proto"];
    for file in files {
        println!("cargo:rerun-if-changed={file}");
    }
    let descriptors = protox::compile(files, ["."])?;
    tonic_prost_build::configure()
        // Weights and frames are passed on without a copy.
        .bytes(".rit.v1.SnapshotPiece.data")
        .bytes(".rit.v1.Frame.header")
        .bytes(".rit.v1.Frame.payload")
        // What callers get is printed as JSON too.
        .message_attribute("rit.v1.RunStatus", SERIALIZE)
        .message_attribute("rit.v1.ActorStatus", SERIALIZE)
        .message_attribute("rit.v1.LedgerStatus", SERIALIZE)
        .message_attribute("rit.v1.Evaluation", SERIALIZE)
        .message_attribute("rit.v1.TaskResult", SERIALIZE)
        .message_attribute("rit.v1.CheckpointResponse", SERIALIZE)
        .message_attribute("rit.v1.CheckpointsStatus", SERIALIZE)
        .message_attribute("rit.v1.Happening", SERIALIZE)
        .message_attribute("rit.v1.Measure", SERIALIZE)
        .message_attribute("rit.v1.MetricsLine", SERIALIZE)
        .message_attribute("rit.v1.Rates", SERIALIZE)
        .message_attribute("rit.v1.Training", SERIALIZE)
        // Evaluations have none.
        .field_attribute("rit.v1.TaskResult.episodes_total", WHERE_KNOWN)
        .field_attribute("rit.v1.TaskResult.policy_lag", WHERE_KNOWN)
        .field_attribute("rit.v1.RunStatus.state", "#[serde(serialize_with = \"crate::state_name\")]")
        .compile_fds(descriptors)?;
    Ok(())
}

const SERIALIZE: &str = "#[derive(serde::Serialize)]";
const WHERE_KNOWN: &str = "#[serde(skip_serializing_if = \"Option::is_none\")]";
