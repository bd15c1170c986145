//! A graph under construction: nodes in order, and the tensors that they read.

use crate::{
    OnnxError,
    messages::{
        AttributeProto, GraphProto, ModelProto, NodeProto, OperatorSetIdProto, StringStringEntryProto,
        TensorProto, TensorShapeProto, TypeProto, ValueInfoProto, attribute_proto::AttributeType,
        tensor_proto::DataType, tensor_shape_proto, type_proto,
    },
};
use prost::Message as _;
use rit_policy::Weights;

/// The set of operators that graphs are written in: ONNX 1.12 of 2022, which all runtimes of today have.
pub const OPSET: i64 = 17;
/// The version of the file's format that goes with it.
const IR_VERSION: i64 = 8;

/// The name of a value: a node's output, an input, or a tensor of the graph.
pub type Value = String;

/// One side of a value's shape.
#[derive(Clone, Copy, Debug)]
pub enum Side {
    /// Known.
    Fixed(usize),
    /// Of any length; equal where it has the same name.
    Any(&'static str),
}

/// A graph that reads these weights.
pub struct Graph<'w> {
    weights: &'w Weights,
    graph: GraphProto,
}

impl<'w> Graph<'w> {
    /// A graph without a node.
    pub fn new(weights: &'w Weights, name: &str) -> Self {
        Self { weights, graph: GraphProto { name: Some(name.to_owned()), ..Default::default() } }
    }

    /// Declares an input.
    pub fn input(&mut self, name: &str, kind: DataType, shape: &[Side], doc: &str) -> Value {
        self.graph.input.push(described(name, kind, shape, doc));
        name.to_owned()
    }

    /// Calls a value by the name that callers know it by, and declares it an output.
    pub fn output(&mut self, value: &Value, name: &str, kind: DataType, shape: &[Side], doc: &str) {
        self.node("Identity", &[value], vec![], name.to_owned());
        self.graph.output.push(described(name, kind, shape, doc));
    }

    /// A node with one output.
    pub fn op(&mut self, kind: &str, inputs: &[&Value], attributes: Vec<AttributeProto>) -> Value {
        let output = format!("{}_{}", kind.to_lowercase(), self.graph.node.len());
        self.node(kind, inputs, attributes, output)
    }

    /// A node that cuts its input's columns into parts of equal width.
    pub fn split(&mut self, value: &Value, parts: usize, width: usize) -> Vec<Value> {
        let widths = self.ints(&vec![width as i64; parts], &[parts]);
        let name = format!("split_{}", self.graph.node.len());
        let output: Vec<Value> = (0..parts).map(|part| format!("{name}_{part}")).collect();
        self.graph.node.push(NodeProto {
            input: vec![value.clone(), widths],
            output: output.clone(),
            name: Some(name),
            op_type: Some("Split".to_owned()),
            attribute: vec![int("axis", 1)],
        });
        output
    }

    fn node(
        &mut self,
        kind: &str,
        inputs: &[&Value],
        attribute: Vec<AttributeProto>,
        output: Value,
    ) -> Value {
        self.graph.node.push(NodeProto {
            input: inputs.iter().map(|&input| input.clone()).collect(),
            output: vec![output.clone()],
            name: Some(output.clone()),
            op_type: Some(kind.to_owned()),
            attribute,
        });
        output
    }

    /// A parameter, by its name in the weights file.
    ///
    /// # Errors
    /// When the model has none of this name.
    pub fn weight(&mut self, name: &str) -> Result<Value, OnnxError> {
        if !self.graph.initializer.iter().any(|tensor| tensor.name() == name) {
            let params = self.weights.model.layout().params();
            let param = params.iter().find(|param| param.name == name);
            let param = param.ok_or_else(|| OnnxError::NoParameter(name.to_owned()))?;
            let values = &self.weights.params[param.range.clone()];
            let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
            self.tensor(name.to_owned(), DataType::Float, &param.shape, bytes);
        }
        Ok(name.to_owned())
    }

    /// A constant of whole numbers; no side is a single number.
    pub fn ints(&mut self, values: &[i64], shape: &[usize]) -> Value {
        let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.constant(DataType::Int64, shape, bytes)
    }

    /// A constant number.
    pub fn float(&mut self, value: f32) -> Value {
        self.constant(DataType::Float, &[], value.to_le_bytes().to_vec())
    }

    fn constant(&mut self, kind: DataType, shape: &[usize], bytes: Vec<u8>) -> Value {
        let dims: Vec<i64> = shape.iter().map(|&side| side as i64).collect();
        let known = self.graph.initializer.iter().find(|tensor| {
            tensor.name().starts_with("constant_")
                && (tensor.data_type(), tensor.raw_data(), &tensor.dims)
                    == (kind as i32, bytes.as_slice(), &dims)
        });
        if let Some(known) = known {
            return known.name().to_owned();
        }
        let name = format!("constant_{}", self.graph.initializer.len());
        self.tensor(name.clone(), kind, shape, bytes);
        name
    }

    fn tensor(&mut self, name: Value, kind: DataType, shape: &[usize], bytes: Vec<u8>) {
        self.graph.initializer.push(TensorProto {
            dims: shape.iter().map(|&side| side as i64).collect(),
            data_type: Some(kind as i32),
            name: Some(name),
            raw_data: Some(bytes),
        });
    }

    /// The file's bytes.
    pub fn encode(self, description: String, doc: &str) -> Vec<u8> {
        let metadata = StringStringEntryProto {
            key: Some(rit_policy::weights_file::DESCRIPTION.to_owned()),
            value: Some(description),
        };
        ModelProto {
            ir_version: Some(IR_VERSION),
            producer_name: Some("rit".to_owned()),
            producer_version: Some(env!("CARGO_PKG_VERSION").to_owned()),
            doc_string: Some(doc.to_owned()),
            graph: Some(self.graph),
            opset_import: vec![OperatorSetIdProto { domain: Some(String::new()), version: Some(OPSET) }],
            metadata_props: vec![metadata],
        }
        .encode_to_vec()
    }
}

/// An attribute that is a number.
pub fn int(name: &str, value: i64) -> AttributeProto {
    let kind = Some(AttributeType::Int as i32);
    AttributeProto { name: Some(name.to_owned()), i: Some(value), r#type: kind, ..Default::default() }
}

/// An attribute that is a list of numbers.
pub fn int_list(name: &str, values: &[i64]) -> AttributeProto {
    let kind = Some(AttributeType::Ints as i32);
    AttributeProto { name: Some(name.to_owned()), ints: values.to_vec(), r#type: kind, ..Default::default() }
}

/// An attribute that is a whole number as a tensor.
pub fn int_tensor(name: &str, value: i64) -> AttributeProto {
    let tensor = TensorProto {
        dims: vec![1],
        data_type: Some(DataType::Int64 as i32),
        name: None,
        raw_data: Some(value.to_le_bytes().to_vec()),
    };
    let kind = Some(AttributeType::Tensor as i32);
    AttributeProto { name: Some(name.to_owned()), t: Some(tensor), r#type: kind, ..Default::default() }
}

fn described(name: &str, kind: DataType, shape: &[Side], doc: &str) -> ValueInfoProto {
    use tensor_shape_proto::{Dimension, dimension::Value as Length};
    let side = |side: &Side| Dimension {
        value: Some(match *side {
            Side::Fixed(length) => Length::DimValue(length as i64),
            Side::Any(name) => Length::DimParam(name.to_owned()),
        }),
    };
    let shape = TensorShapeProto { dim: shape.iter().map(side).collect() };
    let tensor = type_proto::Tensor { elem_type: Some(kind as i32), shape: Some(shape) };
    ValueInfoProto {
        name: Some(name.to_owned()),
        r#type: Some(TypeProto { tensor_type: Some(tensor) }),
        doc_string: Some(doc.to_owned()),
    }
}
