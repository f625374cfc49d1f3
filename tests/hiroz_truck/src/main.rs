//! A truck of ROS 2 by hiroz, which shares nothing with driveby.
//!
//!     hiroz_truck HOST PORT MESSAGES.json
//!
//! The file is a list of [topic, type, stamp in ns, numbers as text, because serde_json rounds]. The
//! drive is shifted to the present and takes its own duration, because the attachments hold the
//! time of sending. Keys, hashes of types, attachments and CDR are those of hiroz.

use std::collections::HashMap;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use hiroz::pubsub::ZPub;
use hiroz::{Builder, Result, context::ZContextBuilder, node::ZNode};
use hiroz_msgs::builtin_interfaces::Time;
use hiroz_msgs::geometry_msgs::{Quaternion, Twist, TwistStamped, Vector3};
use hiroz_msgs::sensor_msgs::{Imu, NavSatFix, NavSatStatus};
use hiroz_msgs::std_msgs::Header;
use serde_json::json;
use zenoh::Wait;

const NS_PER_S: i64 = 1_000_000_000;

/// A message of the file.
struct Measured {
    topic: String,
    kind: String,
    stamp_ns: i64,
    numbers: Vec<f64>,
}

/// A publisher of one topic for each type of message.
enum Publisher {
    Imu(ZPub<Imu, <Imu as hiroz::msg::ZMessage>::Serdes>),
    Fix(ZPub<NavSatFix, <NavSatFix as hiroz::msg::ZMessage>::Serdes>),
    Velocity(ZPub<TwistStamped, <TwistStamped as hiroz::msg::ZMessage>::Serdes>),
}

impl Publisher {
    fn declare(node: &ZNode, topic: &str, kind: &str) -> Result<Self> {
        Ok(match kind {
            "sensor_msgs/msg/Imu" => Self::Imu(node.create_pub::<Imu>(topic).build()?),
            "sensor_msgs/msg/NavSatFix" => Self::Fix(node.create_pub::<NavSatFix>(topic).build()?),
            "geometry_msgs/msg/TwistStamped" => {
                Self::Velocity(node.create_pub::<TwistStamped>(topic).build()?)
            }
            _ => return Err(format!("{topic}: the type is {kind}, it must be known").into()),
        })
    }

    fn key(&self, node: &ZNode) -> Result<String> {
        let entity = match self {
            Self::Imu(one) => one.entity(),
            Self::Fix(one) => one.entity(),
            Self::Velocity(one) => one.entity(),
        };
        Ok(node.keyexpr_format().topic_key_expr(entity)?.to_string())
    }

    fn publish(&self, stamp_ns: i64, numbers: &[f64]) -> Result<()> {
        let header = Header {
            stamp: Time {
                sec: (stamp_ns / NS_PER_S) as i32,
                nanosec: (stamp_ns % NS_PER_S) as u32,
            },
            frame_id: "base".into(),
        };
        match self {
            Self::Imu(one) => one.publish(&Imu {
                header,
                orientation: Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 },
                linear_acceleration: vector(numbers),
                ..Default::default()
            }),
            Self::Fix(one) => one.publish(&NavSatFix {
                header,
                status: NavSatStatus { status: 0, service: 1 },
                latitude: numbers[0],
                longitude: numbers[1],
                altitude: numbers[2],
                position_covariance: diagonal(&numbers[3..6]),
                position_covariance_type: 2,
            }),
            Self::Velocity(one) => one.publish(&TwistStamped {
                header,
                twist: Twist { linear: vector(numbers), angular: vector(&[0.0; 3]) },
            }),
        }
    }
}

fn vector(numbers: &[f64]) -> Vector3 {
    Vector3 { x: numbers[0], y: numbers[1], z: numbers[2] }
}

fn diagonal(variances: &[f64]) -> [f64; 9] {
    let mut covariance = [0.0; 9];
    for (place, variance) in variances.iter().enumerate() {
        covariance[4 * place] = *variance;
    }
    covariance
}

fn read(path: &str) -> Result<Vec<Measured>> {
    let messages: Vec<(String, String, i64, Vec<String>)> =
        serde_json::from_str(&std::fs::read_to_string(path)?)?;
    let mut found = Vec::new();
    for (topic, kind, stamp_ns, words) in messages {
        let numbers = words.iter().map(|word| word.parse()).collect::<std::result::Result<_, _>>()?;
        found.push(Measured { topic, kind, stamp_ns, numbers });
    }
    Ok(found)
}

fn now_ns() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as i64
}

/// Wait until a subscriber of each key is connected.
fn wait_for_subscribers(node: &ZNode, keys: &[String]) -> Result<()> {
    for key in keys {
        let plain = node.session().declare_publisher(key.clone()).wait()?;
        while !plain.matching_status().wait()?.matching() {
            std::thread::sleep(Duration::from_millis(10));
        }
    }
    Ok(())
}

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().collect();
    let [_, host, port, path] = &words[..] else {
        return Err("hiroz_truck HOST PORT MESSAGES.json".into());
    };
    let messages = read(path)?;
    let context = ZContextBuilder::default()
        .with_router_endpoint(format!("tcp/{host}:{port}"))?
        .build()?;
    let node = context.create_node("truck").build()?;
    let mut publishers = HashMap::new();
    for one in &messages {
        if !publishers.contains_key(&one.topic) {
            let declared = Publisher::declare(&node, &one.topic, &one.kind)?;
            publishers.insert(one.topic.clone(), declared);
        }
    }
    let keys: Vec<String> =
        publishers.values().map(|one| one.key(&node)).collect::<Result<_>>()?;
    wait_for_subscribers(&node, &keys)?;
    let shift_ns = now_ns() - messages[0].stamp_ns;
    for one in &messages {
        let early_ns = one.stamp_ns + shift_ns - now_ns();
        if early_ns > 5_000_000 {
            std::thread::sleep(Duration::from_nanos(early_ns as u64));
        }
        publishers[&one.topic].publish(one.stamp_ns + shift_ns, &one.numbers)?;
    }
    println!("{}", json!({"shift_ns": shift_ns, "keys": keys}));
    // The session stays until all messages have arrived.
    std::io::copy(&mut std::io::stdin(), &mut std::io::sink())?;
    Ok(())
}
