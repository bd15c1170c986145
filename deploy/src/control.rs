//! How a command reaches the learner of a run directory.

use crate::{failure::Failure, finished::Finished};
use rit_config::RunDir;
use rit_proto::{
    transport::{self, Address, Client, ConnectError, Credentials},
    v1::control_client::ControlClient,
};
use std::fs;

/// Who answers for a run.
pub enum Reached {
    /// Its learner.
    Learner(ControlClient<Client>),
    /// Its run directory: the run is over.
    Over(Box<Finished>),
}

/// Connects to the run's learner; of a run that is over, reads what it came to.
///
/// # Errors
/// When none runs and the run is not over, or the learner does not answer.
pub async fn reach(run_dir: &RunDir) -> Result<Reached, Failure> {
    match dial(run_dir).await {
        Ok(control) => Ok(Reached::Learner(control)),
        Err(Silence::Absent(failure)) => match Finished::of(run_dir)? {
            Some(finished) => Ok(Reached::Over(Box::new(finished))),
            None => Err(failure),
        },
        Err(Silence::Other(failure)) => Err(failure),
    }
}

/// Connects to the run's learner.
///
/// # Errors
/// When none runs, or it does not answer.
pub async fn connect(run_dir: &RunDir) -> Result<ControlClient<Client>, Failure> {
    dial(run_dir).await.map_err(|silence| match silence {
        Silence::Absent(failure) | Silence::Other(failure) => failure,
    })
}

/// Why the learner cannot be used.
enum Silence {
    /// No learner answers.
    Absent(Failure),
    /// A learner answers and refuses, or another program listens there.
    Other(Failure),
}

async fn dial(run_dir: &RunDir) -> Result<ControlClient<Client>, Silence> {
    fs::metadata(run_dir.address()).map_err(|_| {
        let root = run_dir.root().display();
        Silence::Absent(Failure::runtime_message(format!(
            "no learner runs for {root}; `rit train --resume {root}` goes on with the run"
        )))
    })?;
    // Not what the file says: in a copied directory it leads to the other's learner.
    let address = Address::Unix(run_dir.socket());
    match transport::connect(&address, &Credentials::token(run_dir.token())).await {
        Ok(client) => Ok(ControlClient::new(client)),
        Err(error @ ConnectError::NoAnswer { .. }) => Err(Silence::Absent(error.into())),
        Err(error) => Err(Silence::Other(error.into())),
    }
}
