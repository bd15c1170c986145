//! How a command reaches the learner of a run directory.

use crate::failure::Failure;
use rit_config::RunDir;
use rit_proto::{
    transport::{self, Client, Credentials},
    v1::control_client::ControlClient,
};
use std::fs;

/// Connects to the run's learner.
///
/// # Errors
/// When none runs, or it does not answer.
pub async fn connect(run_dir: &RunDir) -> Result<ControlClient<Client>, Failure> {
    let address = fs::read_to_string(run_dir.address()).map_err(|_| {
        let root = run_dir.root().display();
        Failure::runtime_message(format!(
            "no learner runs for {root}; start it with `rit learner --run-dir {root}`"
        ))
    })?;
    let address = address.trim().parse().map_err(Failure::runtime)?;
    Ok(ControlClient::new(transport::connect(&address, &Credentials::token(run_dir.token())).await?))
}
