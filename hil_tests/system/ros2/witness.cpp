// A robot on eProsima's Fast DDS 2, the default of ROS 2: `witness DOMAIN NAMESPACE`, on loopback.
//
// TUM lines from standard input become nav_msgs/Odometry on /NAMESPACE/odom. What arrives on
// /NAMESPACE/uwb_slam/pose and /NAMESPACE/tf is printed:
//   pose FRAME STAMP_NS X Y QZ QW COVARIANCE(36)
//   tf PARENT CHILD STAMP_NS X Y QZ QW
// After standard input ends it listens for five seconds more.
#include "messagesPubSubTypes.h"

#include <atomic>
#include <chrono>
#include <cstdio>
#include <iostream>
#include <mutex>
#include <sstream>
#include <thread>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

using namespace eprosima::fastdds::dds;
using geometry_msgs::msg::dds_::PoseWithCovarianceStamped_;
using nav_msgs::msg::dds_::Odometry_;
using std_msgs::msg::dds_::Header_;
using tf2_msgs::msg::dds_::TFMessage_;

static std::mutex printing;

static long long stamp_ns(const Header_& header) {
  return header.stamp().sec() * 1000000000LL + header.stamp().nanosec();
}

static void print(const PoseWithCovarianceStamped_& message) {
  const auto& pose = message.pose().pose();
  std::lock_guard<std::mutex> lock(printing);
  std::printf("pose %s %lld %.17g %.17g %.17g %.17g", message.header().frame_id().c_str(),
              stamp_ns(message.header()), pose.position().x(), pose.position().y(),
              pose.orientation().z(), pose.orientation().w());
  for (double value : message.pose().covariance()) std::printf(" %.17g", value);
  std::printf("\n");
}

static void print(const TFMessage_& message) {
  std::lock_guard<std::mutex> lock(printing);
  for (const auto& one : message.transforms()) {
    const auto& moved = one.transform();
    std::printf("tf %s %s %lld %.17g %.17g %.17g %.17g\n", one.header().frame_id().c_str(),
                one.child_frame_id().c_str(), stamp_ns(one.header()), moved.translation().x(),
                moved.translation().y(), moved.rotation().z(), moved.rotation().w());
  }
}

template <typename Message>
static void listen(DataReader* reader, const std::atomic<bool>& over) {
  Message message;
  SampleInfo info;
  while (!over) {
    reader->wait_for_unread_message({0, 100000000});
    while (reader->take_next_sample(&message, &info) == ReturnCode_t::RETCODE_OK)
      if (info.valid_data) print(message);
  }
}

static DomainParticipant* on_loopback(int domain) {
  auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
  udp->interfaceWhiteList.push_back("127.0.0.1");
  DomainParticipantQos qos;
  qos.transport().use_builtin_transports = false;
  qos.transport().user_transports.push_back(udp);
  return DomainParticipantFactory::get_instance()->create_participant(domain, qos);
}

static Topic* topic_of(DomainParticipant* participant, const std::string& name, TypeSupport type) {
  type.register_type(participant);
  return participant->create_topic(name, type.get_type_name(), TOPIC_QOS_DEFAULT);
}

static DataReader* reader_of(Subscriber* subscriber, Topic* topic) {
  DataReaderQos qos = DATAREADER_QOS_DEFAULT;
  qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
  qos.history().depth = 1000;
  return subscriber->create_datareader(topic, qos);
}

int main(int, char** arguments) {
  auto participant = on_loopback(std::stoi(arguments[1]));
  const std::string space = std::string("rt/") + arguments[2];
  auto subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
  TypeSupport pose_type(new geometry_msgs::msg::dds_::PoseWithCovarianceStamped_PubSubType());
  TypeSupport tf_type(new tf2_msgs::msg::dds_::TFMessage_PubSubType());
  TypeSupport odometry_type(new nav_msgs::msg::dds_::Odometry_PubSubType());
  auto poses = reader_of(subscriber, topic_of(participant, space + "/uwb_slam/pose", pose_type));
  auto transforms = reader_of(subscriber, topic_of(participant, space + "/tf", tf_type));
  DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
  qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
  auto writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)
                    ->create_datawriter(topic_of(participant, space + "/odom", odometry_type), qos);

  std::atomic<bool> over{false};
  std::thread of_poses(listen<PoseWithCovarianceStamped_>, poses, std::cref(over));
  std::thread of_transforms(listen<TFMessage_>, transforms, std::cref(over));
  std::string line;
  while (std::getline(std::cin, line)) {
    if (line.empty() || line[0] == '#') continue;
    std::istringstream fields(line);
    std::string stamp;
    double x, y, z, qx, qy, qz, qw;
    fields >> stamp >> x >> y >> z >> qx >> qy >> qz >> qw;
    const auto point = stamp.find('.');
    std::string nanoseconds = stamp.substr(point + 1);
    nanoseconds.resize(9, '0');
    Odometry_ message;
    message.header().stamp().sec(std::stoi(stamp.substr(0, point)));
    message.header().stamp().nanosec(std::stoul(nanoseconds));
    message.header().frame_id("odom");
    message.child_frame_id("base_link");
    message.pose().pose().position().x(x);
    message.pose().pose().position().y(y);
    message.pose().pose().orientation().z(qz);
    message.pose().pose().orientation().w(qw);
    writer->write(&message);
  }
  std::this_thread::sleep_for(std::chrono::seconds(5));
  over = true;
  of_poses.join();
  of_transforms.join();
  std::fflush(stdout);
  std::_Exit(0);
}
