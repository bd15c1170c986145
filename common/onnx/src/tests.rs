//! What can be said of graphs without a runtime; `deploy/python/tests/test_export.py` runs them in one.

use super::*;
use crate::messages::{ModelProto, TensorProto, ValueInfoProto};
use prost::Message as _;
use rit_algo::Model;
use rit_policy::{Description, TaskNames, weights_file};
use std::{collections::HashSet, sync::Arc};

fn weights(settings: &[&str]) -> Weights {
    let settings: Vec<_> = settings.iter().map(|text| rit_config::set(text).unwrap()).collect();
    let config =
        rit_config::resolve("environment.task_set = \"cooperative-navigation\"", "test", &settings).unwrap();
    let model = Arc::new(Model::new(config.model()).unwrap());
    let params: Vec<f32> = (0..model.layout().len()).map(|at| (at as f32).sin()).collect();
    let digest = weights_file::digest(&params);
    let description = Description::new(model.config(), &TaskNames::of(&config), digest);
    Weights { description, model, params }
}

fn each() -> Vec<Weights> {
    let of_method = |name: &str| weights(&[&format!("algorithm.name={name}")]);
    let mut all: Vec<Weights> = exportable().into_iter().map(of_method).collect();
    all.push(weights(&["algorithm.name=refil", "algorithm.encoder=beside"]));
    all
}

#[test]
fn every_value_is_made_once_before_it_is_read() {
    for weights in each() {
        let graphs = graphs(&weights).unwrap();
        for bytes in [graphs.encoder, graphs.head] {
            let model = ModelProto::decode(bytes.as_slice()).unwrap();
            assert_eq!(model.opset_import[0].version(), OPSET);
            let graph = model.graph.unwrap();
            let given = graph.input.iter().map(ValueInfoProto::name);
            let mut known: HashSet<&str> =
                given.chain(graph.initializer.iter().map(TensorProto::name)).collect();
            assert_eq!(known.len(), graph.input.len() + graph.initializer.len());
            for node in &graph.node {
                for input in &node.input {
                    assert!(known.contains(input.as_str()), "{} reads {input}", node.name());
                }
                for output in &node.output {
                    assert!(known.insert(output), "{output} is made twice");
                }
            }
            assert!(graph.output.iter().all(|output| known.contains(output.name())));
        }
    }
}

/// A graph that read the mixer's parameters, or left one of acting's out, would be another network's.
#[test]
fn together_they_hold_the_parameters_of_acting_to_the_bit() {
    for weights in each() {
        let graphs = graphs(&weights).unwrap();
        let mut found = HashSet::new();
        for bytes in [&graphs.encoder, &graphs.head] {
            let graph = ModelProto::decode(bytes.as_slice()).unwrap().graph.unwrap();
            for tensor in graph.initializer.iter().filter(|tensor| !tensor.name().starts_with("constant_")) {
                let params = weights.model.layout().params();
                let param = params.iter().find(|param| param.name == tensor.name()).unwrap();
                assert!(weights.model.acting().contains(&param.range.start), "{}", param.name);
                let bytes: Vec<u8> = weights.params[param.range.clone()]
                    .iter()
                    .flat_map(|value| value.to_le_bytes())
                    .collect();
                assert_eq!(tensor.raw_data(), bytes);
                found.insert(param.name.clone());
            }
        }
        let acting = weights.model.layout().params().iter();
        let acting = acting.filter(|param| weights.model.acting().contains(&param.range.start)).count();
        assert_eq!(found.len(), acting, "{}", weights.model.method());
    }
}

#[test]
fn other_methods_are_refused_with_those_that_can() {
    let able = "rit, rit-vdn, rit-no-task-representations, qmix-attn, vdn-attn, qmix-int, vdn-int, refil";
    for name in ["updet-mix", "updet-vdn", "roma", "mappo", "mat"] {
        let error = graphs(&weights(&[&format!("algorithm.name={name}")])).unwrap_err().to_string();
        assert!(
            error.starts_with(&format!("{name} cannot be exported to ONNX; these can: {able}. ")),
            "{error}"
        );
    }
}
