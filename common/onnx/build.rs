//! Generates the messages of a model. `protox` compiles the .proto file, so no system `protoc` is needed.

fn main() -> Result<(), Box<dyn std::error::Error>> {
    const FILE: &str = "proto/onnx.proto";
    println!("cargo:rerun-if-changed={FILE}");
    let descriptors = protox::compile([FILE], ["proto"])?;
    prost_build::Config::new().compile_fds(descriptors)?;
    Ok(())
}
