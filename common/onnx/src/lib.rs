//! Trained policies as ONNX: two graphs that any runtime of ONNX can act with, weights inside.
//!
//! The *encoder* turns what all agents see into histories and task representations; recurrent state goes in and comes out.
//! The *head* turns one agent's history, and the actions of those that decided before it, into utilities and its greedy
//! action. Agents and entities are axes of any length. The formulas are those of `deploy/docs/weights.md`.

mod graph;
mod networks;

#[allow(missing_docs, reason = "the .proto file and the specification of ONNX say what they are")]
mod messages {
    include!(concat!(env!("OUT_DIR"), "/onnx.rs"));
}

pub use graph::OPSET;

use rit_algo::Method;
use rit_policy::Weights;

/// The two files.
#[derive(Clone, Debug)]
pub struct Graphs {
    /// `encoder.onnx`.
    pub encoder: Vec<u8>,
    /// `head.onnx`.
    pub head: Vec<u8>,
}

/// Why weights make no graphs.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OnnxError {
    /// A method whose networks are not written as graphs.
    #[error(
        "{0} cannot be exported to ONNX; these can: {known}. `rit.Policy` in Python and the crate rit-policy act with it",
        known = exportable().join(", ")
    )]
    Method(Method),
    /// A parameter that a graph of its method reads.
    #[error("the model has no parameter {0}")]
    NoParameter(String),
    /// A description that is no text.
    #[error("the model's description cannot be written: {0}")]
    Description(String),
}

/// Names of the methods that can be exported.
pub fn exportable() -> Vec<&'static str> {
    Method::ALL.into_iter().filter(|method| can_export(*method)).map(Method::name).collect()
}

/// Whether a method's networks are those of `networks.rs`: an encoder of the one kind or the other, a GRU and a head. Each
/// method is named, so that a new one does not compile before it is decided for it.
fn can_export(method: Method) -> bool {
    match method {
        Method::Rit
        | Method::RitVdn
        | Method::RitNoTaskRepresentations
        | Method::QmixAttn
        | Method::VdnAttn
        | Method::QmixInt
        | Method::VdnInt
        | Method::Refil => true,
        Method::UpdetMix | Method::UpdetVdn | Method::Roma | Method::Mappo | Method::Mat => false,
    }
}

/// The graphs of these weights.
///
/// # Errors
/// When their method cannot be exported.
pub fn graphs(weights: &Weights) -> Result<Graphs, OnnxError> {
    let method = weights.model.method();
    if !can_export(method) {
        return Err(OnnxError::Method(method));
    }
    let text = weights.description.to_json().map_err(|error| OnnxError::Description(error.to_string()))?;
    let doc = |what: &str| {
        format!("{what} of a policy that {method} has trained on {}", weights.description.task_set)
    };
    Ok(Graphs {
        encoder: networks::encoder(weights)?
            .encode(text.clone(), &doc("All agents' histories and task representations")),
        head: networks::head(weights)?.encode(text, &doc("One agent's utilities")),
    })
}

#[cfg(test)]
mod tests;
